"""What a training needs of the machine it runs on."""

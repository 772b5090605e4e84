"""What `tom reproduce` computes and draws: a claim of the paper a file, its figure beside it."""

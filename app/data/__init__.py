"""What the pages show, read from run folders once and kept while the files stay as they are."""

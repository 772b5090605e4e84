"""What `tom reproduce` computes: one claim of the paper a file, and nothing about how it looks."""

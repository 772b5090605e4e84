"""The studies of `tom reproduce`: one module per claim of the paper, one for its figure."""

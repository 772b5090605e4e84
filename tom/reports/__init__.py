"""How results are shown: the look of figures, HTML pages, and what they were made with."""

"""The presentation of results: style of figures, HTML pages, and their origin."""

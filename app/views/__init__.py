"""The studio's pages, one a file: `TITLE`, `ICON`, `PATH` and `page()`."""

"""The studio's pages: `TITLE`, `ICON`, `PATH` and `page()`. A page with parts is a package."""

"""The studio's pages, each with `page()`. A page with parts is a package."""

"""The data of the pages, read from run folders and cached until the files change."""

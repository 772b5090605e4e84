"""The studio's processes, which start and end together, and tools that look at its pages."""

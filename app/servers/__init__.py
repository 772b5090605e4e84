"""The studio's processes: started, linked and ended together, and looked at from outside."""

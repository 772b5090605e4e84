"""Stacked networks and their training: many members' networks as one."""

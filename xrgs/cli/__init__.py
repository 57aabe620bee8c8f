"""The commands, one file each, with their arguments."""

"""The commands, one file each, with the schema of a command's arguments beside it."""

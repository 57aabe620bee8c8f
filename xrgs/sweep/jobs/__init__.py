"""Runs one cell's job: a child process under limits, whose parent holds the cell's lease."""

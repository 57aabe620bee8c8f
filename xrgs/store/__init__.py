"""What a cell is, and where it is kept."""

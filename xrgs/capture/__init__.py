"""From photographs to a frozen mixed-resolution dataset."""

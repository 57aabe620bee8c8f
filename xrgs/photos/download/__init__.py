"""Downloads published scenes: fetches an archive, verifies it and unpacks it."""

"""One cell's job: a process of its own, under limits, whose owner has the cell's lock."""

"""Plans a sweep, runs its cells and reports their state."""

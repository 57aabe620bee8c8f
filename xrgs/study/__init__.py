"""A study: its plan, its way to a launcher, and how far it is."""

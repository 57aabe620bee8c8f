"""The evaluation protocol and the metrics that cells are compared by."""

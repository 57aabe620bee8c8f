"""Makes a frozen mixed-resolution dataset from photographs: a variant."""

"""Makes a variant from photographs: a frozen mixed-resolution dataset."""

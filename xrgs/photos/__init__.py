"""Turns what people have into one plain folder: upright sRGB photographs, masks and lenses."""

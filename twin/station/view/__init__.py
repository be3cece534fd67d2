"""What the views of a run are made of: drawing, stroboscope, spectrum, scales, styles."""

"""Files of measured data, whatever their format, as named arrays that can be read in parts."""

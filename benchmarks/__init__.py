"""How fast the program is, against the reference libraries, side by side in one run."""

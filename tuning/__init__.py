"""Retuning by convex optimisation under a power budget: limit, gains, verification, proposals."""

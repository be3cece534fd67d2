"""Recorded tests, each with its configuration and expected results, and how they were made."""

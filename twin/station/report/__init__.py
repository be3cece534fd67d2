"""Runs on record: the page that is filed after a test, and runs laid side by side."""

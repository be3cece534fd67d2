"""The twin of an active vibration rig: plant, control, rig and station rooms."""

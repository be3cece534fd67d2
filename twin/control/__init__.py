"""What runs on the rig: control law, filter chain, schedule; and the analysis of the loop they close."""

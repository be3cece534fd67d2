"""Where blocks come from and commands go: simulated rig, live gateway, file readers, recorder."""

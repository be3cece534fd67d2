"""Kalman observer, excitation tracker and damping identification: estimates with their uncertainty."""

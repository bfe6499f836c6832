"""The calibrated rig: its motion, the false displacement, and the uncertainty of both."""

"""Cameras that speak GenICam, through Aravis or a GenTL producer."""

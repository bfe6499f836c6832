"""The record's one zero: where each calibration's reference lies in it, and how that is found."""

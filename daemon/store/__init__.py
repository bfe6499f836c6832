"""Where measurements and frames are kept."""

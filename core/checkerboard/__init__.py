"""The sub-camera's target: corners found, located to sub-pixels, and the pose they give."""

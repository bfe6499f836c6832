"""Room on the disk: what is kept of the frames, the reserve, and what to do when it is full."""

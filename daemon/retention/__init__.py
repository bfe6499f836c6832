"""What is kept of the frames, what goes first, and the space held in reserve."""

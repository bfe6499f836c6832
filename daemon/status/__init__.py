"""What is known of the system now, and what is wrong with it."""

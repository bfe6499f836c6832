"""What both cameras see, live, for whoever aims and focuses them."""

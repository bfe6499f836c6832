"""The web page: the record to look at, aiming, and the JSON behind both."""

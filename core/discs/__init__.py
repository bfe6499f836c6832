"""The main camera's target: discs found, identified and located to sub-pixels."""

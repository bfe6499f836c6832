"""What dcam costs: time per pair and memory over many slots. Run with `make bench`."""

"""The frame archive: images on disk, a table for each day."""

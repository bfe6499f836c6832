"""The sub-camera's lens from views of a board."""

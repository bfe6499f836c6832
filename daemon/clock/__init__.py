"""Which boot this is, whether its clock is right, and times put right when it was not."""

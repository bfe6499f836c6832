"""The simulated rig: one world, two rendered cameras, a head that moves it."""

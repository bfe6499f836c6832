"""How dcamd and its surroundings talk: control socket, signals, systemd, run state."""

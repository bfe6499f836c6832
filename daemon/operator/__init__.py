"""How systemd and an operator talk with a running dcamd, and what they are told."""

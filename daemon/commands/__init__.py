"""One module a `dcam-ctl` command."""

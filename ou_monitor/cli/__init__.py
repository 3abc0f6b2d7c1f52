"""The `ou-monitor` program: its commands, arguments and output."""

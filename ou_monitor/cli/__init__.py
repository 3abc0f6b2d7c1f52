"""The `ou-monitor` command, one module a verb."""

"""The `ou-monitor` command, one module per verb."""

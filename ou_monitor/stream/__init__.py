"""Messages, as msg_config/*.yaml describes them -> samples for the monitor."""

"""Messages, as msg_config/*.yaml describes them -> samples; reading and writing of user files."""

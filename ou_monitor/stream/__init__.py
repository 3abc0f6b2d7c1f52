"""Turn messages (described by msg_config/*.yaml) into samples; read and write user files."""

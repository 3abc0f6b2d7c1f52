"""A message, as msg_config/*.yaml describes it -> samples."""

"""A voltage from the kernel: Linux IIO and hwmon."""

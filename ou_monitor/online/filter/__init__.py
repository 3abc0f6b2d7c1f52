"""The adaptive low-pass: sigma -> cutoff -> output."""

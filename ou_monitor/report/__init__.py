"""Reports of the commands: one `*_document` for each, as page or text; and `Result`."""

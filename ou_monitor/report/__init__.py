"""Reports of the commands: one `*_document` for each, written as HTML page or terminal text."""

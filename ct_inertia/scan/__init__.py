"""Open scans of any format and read parts of them."""

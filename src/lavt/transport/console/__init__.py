"""The console: the connection to the web page from which a person drives (docs/drive.md)."""

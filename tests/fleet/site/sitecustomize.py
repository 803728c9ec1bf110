"""Put on the path of a Python process, lets it know the file system of troubles."""

from fsspec import register_implementation

register_implementation("trouble", "tests.fleet.trouble.Trouble")

"""Settings of studies on real people; ``popl-people study=<name> data.load=<their data>``."""

"""The only loop, and what people see of it: Rerun, the web page, reports, the command line."""

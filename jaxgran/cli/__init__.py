"""The command line: reads options, prints, and ends with an exit status.

It may import all other folders, and none imports it. Begin with `app`, then the file named like the
command.
"""

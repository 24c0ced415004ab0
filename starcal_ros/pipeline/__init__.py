"""Processing steps shared by the nodes and the tool."""

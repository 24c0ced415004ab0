"""The steps that the nodes and the tool share."""

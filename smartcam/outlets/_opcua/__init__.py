"""Cameras as machine-vision systems of OPC UA, according to OPC 40100-1.

The nodeset beside these modules, ``MachineVision.NodeSet2.xml.gz``, is the OPC Foundation's,
version 1.0.0 of 2019-07-11, under its MIT licence, which stands in the file and beside it.
"""

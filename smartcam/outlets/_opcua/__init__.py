"""Cameras as machine-vision systems of OPC UA, according to OPC 40100-1.

The nodeset in this folder, ``MachineVision.NodeSet2.xml.gz``, defines the types and nodes of OPC
40100-1. The OPC Foundation published it (version 1.0.0 of 2019-07-11) under its MIT licence; the
file contains the licence, and so does this folder.
"""

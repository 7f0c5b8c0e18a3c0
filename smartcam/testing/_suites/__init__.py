"""Suites for authors of plug-ins: subclass, give examples, inherit the tests."""

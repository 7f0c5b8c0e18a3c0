"""Tests of programs that inspect pictures."""

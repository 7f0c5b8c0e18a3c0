"""Internals of the client, by which a link's bytes reach the tasks that wait for them."""

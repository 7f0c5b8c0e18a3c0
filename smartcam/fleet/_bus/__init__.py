"""The bus: keys and messages, as bytes and as JSON, in one process or over Zenoh."""

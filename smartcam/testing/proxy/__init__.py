"""A link that breaks as told: it stands between a client and a camera and works on the bytes."""

"""From an action to a stimulus (Encoder), and from a response to a command (Decoder, mappings)."""

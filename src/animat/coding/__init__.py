"""What an action is as a stimulus (Encoder), and what a response is as a command (Decoder, mappings)."""

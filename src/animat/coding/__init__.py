"""What an action is as a stimulus."""

"""Events and other observations from pictures."""

"""The places of maps, and where a local map lies among them: the look-up of answers, loops and joins."""

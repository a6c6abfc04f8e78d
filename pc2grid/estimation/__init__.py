"""Tracking from scan to scan: KISS-ICP, matching with a local map in the plane or in space, and one
smoother."""

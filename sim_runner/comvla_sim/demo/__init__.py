"""The demo: four instructions over a fading link, and a film of each."""

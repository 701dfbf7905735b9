"""The virtual world: telemetry as a page in the browser (`bridge`) and as a table in the terminal (`watch`).

It only reads. It may be stalled, killed or absent without any effect on control.
"""

"""The car as its bus shows it: driving robots, plant and navigation system, in real or in virtual time.

It shares the DBC with the gateway and nothing else, so that it is a second, independent reader of the contract.
"""

"""Isolation of foreign code: it runs in guest processes, inside bubblewrap where that is available.

`client` and `retest` are of the host, `worker` and `estimator_handler` of a guest, `launch`,
`bubblewrap` and `guest` its start, container and end, `messages` what they say to each other.

The host holds the truth of the test drives, their roads and their seeds, and never sends them.
`docs/isolation.md` says what is guaranteed, and what is not.
"""

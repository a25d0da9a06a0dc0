"""Server of sessions: each session is a world that a client steps, and that survives a crash.

Environments and their actions are in `env`, and the `egosim serve` command is in `cli`.

- `client`: `Client` and `RemoteSession`, without jax.
- `wire`: MessagePack and JSON messages.
- `errors`: `RequestError`, the HTTP status, code and message of a refused request.
- `requests`: fields of each request and their checks.
- `session`: `Session`, the journaled steps of one world in a folder.
- `parts`: steps whose rows are given part by part.
- `store`: `Store`, all sessions and their bounded queue.
- `service`: `Service`, from a request to its reply.
- `server`: `make_app`, `bind`, `serve`, HTTP and websocket.
- `guard`: checks before a request is read: connections, token, origin, size and time.
- `prometheus`: `Metrics`.
- `replicas`: `app`, sessions on several machines by Ray Serve.
- `dataset_export`: recorded sessions as LeRobot datasets, shards and Rerun recordings.
"""

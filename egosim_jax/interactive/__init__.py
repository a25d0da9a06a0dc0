"""Interactive use of a world, step by step: by policies, remote clients, or in the browser.

Batch simulation of whole episodes is in `simulation`, offline scores are in `evaluation`.

- `options`: `ClipOptions` and `Limits`, options of the commands.
- `env`: Gymnasium environments. `make`, `make_vec`, `load_backend`, `ActionSpec`, `Start`.
- `server`: sessions behind a websocket and HTTP. `client.Client`, `service.open_service`,
  `server.serve`, `replicas.app`, `dataset_export`.
- `play`: page in the browser. `viewer.Page`, `played_episode.PlayedEpisode`.
"""

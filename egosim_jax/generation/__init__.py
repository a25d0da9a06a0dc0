"""From triplets to clips: everything that runs a model.

Networks, solvers and input rules are in lower layers; loops over a state are in `simulation`.

    generator    Generator: triplets to clips; `denoise`, the sampler
    encoding     triplets to batches to conditions
    compiled     CompiledFn: a function of networks, compiled once for each shape
    stream       Streamer: frames as they are decoded
    batch        BatchJob: a folder of clips, resumable
    rank         candidate actions by the goal that their clips reach
    export       conditions as files
"""

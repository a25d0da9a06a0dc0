"""From triplets to clips: everything that runs a model.

Networks, solvers and input rules are in lower layers; loops over a state are in `simulation`.

    generator    Generator: triplets to clips; `denoise`, the sampler
    encoding     triplets to batches to conditions
    compiled     CompiledFn: a function of networks, compiled once for each shape
    causal       ChunkDenoiser: the chunks of a causal student
    stream       ClipStream: conditions in and frames out, chunk by chunk
    batch        BatchJob: a resumable folder of clips; baselines
    rank         candidate actions by how well their clips reach a goal
    export       conditions as files
"""

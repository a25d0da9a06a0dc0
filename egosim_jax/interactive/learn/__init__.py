"""Our worlds for libraries that train policies; needs the extra `rl`.

- `flat`: a vector environment of flat numbers by a `Skill`; TorchRL wraps it as it is.
- `lift`: the skill of lifting an object.
- `stable_baselines`: a `VecEnv` of Stable-Baselines3.
- `rlinf`: an environment of RLinf.
"""

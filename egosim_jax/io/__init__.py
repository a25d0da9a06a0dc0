"""Files: bounded reading of untrusted bytes, and atomic writing.

Readers of a dataset's layout belong to `data`, and conversion of other projects' weights to
`convert`. `io` knows no clip, no model config and no command.

- bounded: open_regular, read_bytes, read_json, read_lines, and quoting for messages
- untrusted: readers of HDF5, Parquet, COLMAP, npz, pickles and `.pth`; they run no code in a file
- atomic: atomic_write, atomic_folder, append_line, lock_folder
- digest: sha256 of files and folders, fingerprint of values
- images: read_image, decode_image, decode_labels, read_depth_image; colors as sRGB
- video, decoding, containers, timing: probe and read videos, at a constant rate
- writing: write videos
- weights, mapped: save and load networks; memory-mapped safetensors
- checkpoint, run, journal: training checkpoints, run folders, resumable phases
- hub, wheels: download pinned weights and files
- private, executables: cache of compiled programs that only its user can write
"""

"""Readers of file formats that could run code or exhaust memory.

Each checks sizes and types before it builds anything, and raises `InputError`. Plain bytes, JSON
and lines are read by `egosim_jax.io.bounded`.

- isolated: read_file, which runs a reader in a child process with limits of memory and time
- hdf5, parquet, colmap: read_hdf5, read_parquet, read_model, each in that child process
- mjcf: check_files of MuJoCo models, which are compiled in that child process
- xml_tree: parse_xml, the elements of an XML file
- npz: read_arrays of an npz, read_npy
- pickled, pickled_arrays: interpreter of pickles; NumPy arrays, and MANO's models
- zipped: entries of zip archives, bounded by what they expand to
- pth: tensors of PyTorch's files
"""

#!/usr/bin/env python3
"""Makes the files in this folder. Nothing runs this script: it records how the files were made.

    python3 -m venv v; v/bin/pip install h5py==3.16.0 numpy==2.4.6; v/bin/python tests/hdf5/make.py   (HDF5 2.0.0)
    and with h5py==3.8.0 'numpy<2' on Python 3.11, argument 1.12: the files whose names end in -1.12  (HDF5 1.12.2)

Each NAME.z is an HDF5 file: its size (8 bytes, least significant first), then the file as a zlib stream. The values
follow v(i) = 37 i mod 251, i the number of the element, row-major: float v / 128, signed v - 125, unsigned v, bool
v mod 2; where something else is stored, test_hdf5.cpp says what.
"""
import ctypes, glob, os, pathlib, struct, subprocess, sys, tempfile, zlib
import h5py
import numpy as np

here = pathlib.Path(__file__).parent
suffix = "-1.12" if "1.12" in sys.argv else ""
assert h5py.version.hdf5_version.startswith(suffix[1:] or "2.0")


def values(shape, dtype):
    dtype = np.dtype(dtype)
    v = 37 * np.arange(int(np.prod(shape)), dtype=np.int64) % 251
    v = {"f": v / 128, "i": v - 125, "u": v, "b": v % 2 == 1}[dtype.kind]
    return np.reshape(v, shape).astype(dtype)


def pack(name, data):
    (here / (name + suffix + ".z")).write_bytes(struct.pack("<Q", len(data)) + zlib.compress(data, 9))
    print(name + suffix, len(data), (here / (name + suffix + ".z")).stat().st_size)


def make(name, fill_in, istore_k=None, **options):
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "f")
        if istore_k:  # other than usual: superblock 1
            fcpl = h5py.h5p.create(h5py.h5p.FILE_CREATE)
            assert library.H5Pset_istore_k(fcpl.id, istore_k) >= 0
            fapl = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
            fapl.set_libver_bounds(h5py.h5f.LIBVER_EARLIEST, h5py.h5f.LIBVER_LATEST)
            h5py.h5f.create(path.encode(), h5py.h5f.ACC_TRUNC, fcpl, fapl).close()
        with h5py.File(path, "r+" if istore_k else "w", **options) as f:
            fill_in(f)
        pack(name, open(path, "rb").read())


def put(g, name, shape, dtype, **options):
    g.create_dataset(name, data=values(shape, dtype), **options)


def low_level(g, name, shape, dtype, maxshape=None, chunks=None, change=None, write=True):
    dcpl = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    if chunks:
        dcpl.set_chunk(chunks)
    if change:
        change(dcpl)
    space = h5py.h5s.create_simple(shape, tuple(h5py.h5s.UNLIMITED if m is None else m for m in maxshape or shape))
    d = h5py.Dataset(h5py.h5d.create(g.id, name.encode(), h5py.h5t.py_create(np.dtype(dtype)), space, dcpl))
    if write:
        d[...] = values(shape, dtype)
    return d


def types(f):
    for t in ["f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "?"]:
        put(f, "types/" + np.dtype(t).name, (3, 5), t)
        if t[-1] in "248":
            put(f, "types/" + np.dtype(t).name + "_big", (3, 5), ">" + t)
    f["types/scalar"] = np.float64(-125 / 128)
    f["types/none"] = values((0, 4), "f4")
    f["types/null"] = h5py.Empty("f4")
    colour = h5py.enum_dtype({"RED": 0, "GREEN": 1, "BLUE": 7}, basetype="u2")
    f.create_dataset("types/enumeration", data=np.array([7, 0, 1], "u2"), dtype=colour)


def texts(f):
    f["text/scalar"] = np.bytes_("tanh_gaussian")
    for name, pad in [("nul_ended", h5py.h5t.STR_NULLTERM), ("nul_padded", h5py.h5t.STR_NULLPAD), ("spaces", h5py.h5t.STR_SPACEPAD)]:
        t = h5py.h5t.C_S1.copy()
        t.set_size(8)
        t.set_strpad(pad)
        d = h5py.h5d.create(f["text"].id, name.encode(), t, h5py.h5s.create(h5py.h5s.SCALAR))
        d.write(h5py.h5s.ALL, h5py.h5s.ALL, np.array(b"relu    " if name == "spaces" else b"relu\0\0\0\0", "S8"), mtype=t)
    f["text/two"] = np.array([b"ab", b"c"])


def strange(f):  # to be listed, not read; attributes, links and a named type to be passed over
    f["strange/compound"] = np.zeros(2, [("a", "i4"), ("b", "f8")])
    f["strange/variable"] = ["one", "three"]
    f["strange/half"] = np.zeros(2, "f2")
    f.create_dataset("strange/array", (2,), "(3,)f4")
    f.create_dataset("strange/lzf", data=values((100,), "f4"), compression="lzf")
    f["strange/named"] = np.dtype("f4")
    f.create_dataset("strange/shared", data=values((3,), "f4"), dtype=f["strange/named"])
    f["strange/soft"] = h5py.SoftLink("/types/float32")
    f["strange/external"] = h5py.ExternalLink("elsewhere.hdf5", "/x")
    f.create_dataset("strange/reference", data=[f["strange"].ref], dtype=h5py.ref_dtype)
    for i in range(12):  # more than fit into the header's first block
        f["strange"].attrs["attribute%d" % i] = np.arange(20)
    f.create_virtual_dataset("strange/virtual", h5py.VirtualLayout((4,), "f4")) if suffix == "" else None


def filters(f):
    for name in ["d", "s", "f", "sd", "sf", "df", "sdf"]:
        o = dict(chunks=(4, 3), compression="gzip" if "d" in name else None, shuffle="s" in name, fletcher32="f" in name)
        put(f, "filters/" + name, (10, 7), "f4", **o)

    def other_order(dcpl):  # fletcher32, then deflate, then shuffle; shuffle twice
        dcpl.set_fletcher32()
        dcpl.set_deflate(5)
        dcpl.set_shuffle()
    low_level(f["filters"], "fds", (10, 7), "f8", chunks=(4, 3), change=other_order)

    def masks(dcpl):
        dcpl.set_shuffle()
        dcpl.set_deflate(5)
    d = low_level(f["filters"], "masks", (4, 6), "i4", chunks=(2, 2), change=masks, write=False)
    v = values((4, 6), "i4")
    for r in range(2):  # each chunk with other filters skipped
        for c in range(3):
            mask = (3 * r + c) % 4
            data = v[2 * r:2 * r + 2, 2 * c:2 * c + 2].tobytes()
            if not mask & 1:
                data = np.frombuffer(data, "u1").reshape(4, 4).T.tobytes()
            if not mask & 2:
                data = zlib.compress(data)
            d.id.write_direct_chunk((2 * r, 2 * c), data, mask)


def chunks(f):
    put(f, "chunks/one", (5,), "f4", chunks=(5,))
    put(f, "chunks/one_gzip", (5, 5), "f4", chunks=(5, 5), compression="gzip")
    put(f, "chunks/fixed", (7, 9), "f4", chunks=(2, 4))
    put(f, "chunks/fixed_gzip", (7, 9, 2), "f4", chunks=(2, 4, 1), compression="gzip")
    put(f, "chunks/fixed_may_grow", (5, 6), "f4", chunks=(2, 2), maxshape=(9, 11))
    put(f, "chunks/rows", (50, 3), "f4", chunks=(3, 3), maxshape=(None, 3))
    put(f, "chunks/columns_gzip", (4, 30), "f8", chunks=(3, 2), maxshape=(9, None), compression="gzip", shuffle=True)
    put(f, "chunks/both", (11, 9), "f4", chunks=(2, 2), maxshape=(None, None))
    put(f, "chunks/both_gzip", (11, 9), "f4", chunks=(3, 2), maxshape=(None, None), compression="gzip")
    low_level(f["chunks"], "implicit", (7, 5), "f4", (7, 8), (2, 3), lambda p: p.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY))
    d = f.create_dataset("chunks/holes", (6, 6), "f4", chunks=(2, 2), fillvalue=-2.5)
    d[2:4, 2:4] = 7
    d = f.create_dataset("chunks/holes_gzip", (10,), "i2", chunks=(3,), maxshape=(None,), compression="gzip", fillvalue=9)
    d[4] = 1
    f.create_dataset("chunks/nothing", (3,), "f8", chunks=(2,))
    f.create_dataset("chunks/unwritten", (3,), "f4", fillvalue=0.5)
    put(f, "chunks/none", (0, 3), "f4", chunks=(2, 3), maxshape=(None, 3))
    d = f.create_dataset("chunks/shrunk", data=values((20,), "u1"), chunks=(3,), maxshape=(None,))
    d.resize((10,))
    d = f.create_dataset("chunks/grown", data=values((20,), "u1"), chunks=(3,), maxshape=(None,))
    d.resize((40,))


def compact(f):
    low_level(f, "compact", (6,), "f4", change=lambda p: p.set_layout(h5py.h5d.COMPACT))


def large_indexes(f):
    put(f, "deep", (1100, 2), "u1", chunks=(1, 1))  # old: a tree of three levels; new: a fixed array of three pages
    put(f, "rows", (500,), "u1", chunks=(1,), maxshape=(None,))  # new: secondary blocks
    put(f, "rows_gzip", (300,), "u1", chunks=(1,), maxshape=(None,), compression="gzip")
    put(f, "both", (20, 30), "u1", chunks=(1, 1), maxshape=(None, None))  # new: a tree of two levels
    d = f.create_dataset("sparse_pages", (9000,), "u1", chunks=(1,), fillvalue=3)
    d[[0, 4096, 5119, 8999]] = 200
    d = f.create_dataset("sparse_rows", (140000,), "u1", chunks=(1,), maxshape=(None,), fillvalue=3)
    d[[0, 131059, 131060, 132083, 132084, 133108, 135000, 139999]] = 200  # new: pages, from number 131060 on


library = ctypes.CDLL(glob.glob(os.path.join(os.path.dirname(h5py.__file__), "..", "h5py.libs", "libhdf5-*"))[0])
library.H5Pset_chunk_opts.argtypes = [ctypes.c_int64, ctypes.c_uint]  # these two are not in h5py
library.H5Pset_istore_k.argtypes = [ctypes.c_int64, ctypes.c_uint]


def edges(f):
    def change(dcpl):
        dcpl.set_deflate(5)
        assert library.H5Pset_chunk_opts(dcpl.id, 2) >= 0
    low_level(f, "whole_edges", (7, 5), "f4", chunks=(3, 2), change=change)
    low_level(f, "whole_edges_rows", (7, 5), "f4", (None, 5), (3, 2), change)


def small(f):  # for damage of every kind: short, and yet something of most things
    put(f, "a", (5, 3), "f4", chunks=(2, 2), compression="gzip", shuffle=True, fletcher32=True)
    put(f, "b/c", (4,), "f8")
    put(f, "b/flags", (9,), "?", chunks=(2,), maxshape=(None,))
    f["b/text"] = np.bytes_("SAC")
    put(f, "b/both", (3, 3), "i2", chunks=(2, 2), maxshape=(None, None), compression="gzip")
    put(f, "fixed", (5,), "f4", chunks=(2,))
    compact(f)
    for i in range(10):
        f["many/%d" % i] = h5py.SoftLink("/a") if i < 8 else f["a"]


def many(f):  # new: a heap of several blocks, a tree of three levels; old: a tree of two levels
    f["a"] = np.int32(-125)
    for i in range(5000 if f.libver[0] != "earliest" else 400):
        f["many/episode_%d" % i] = f["a"]


def long_names(f):  # new: blocks of the heap that are reached through a block of blocks
    put(f, "a", (3,), "f4")
    for i in range(300):
        f["long/" + "x" * 2900 + "%03d" % i] = f["a"]


def d4rl(f):
    n = 700
    for name, shape, t in [("observations", (n, 11), "f4"), ("next_observations", (n, 11), "f4"), ("actions", (n, 3), "f4"),
                           ("rewards", (n,), "f4"), ("terminals", (n,), "?"), ("timeouts", (n,), "?"),
                           ("infos/action_log_probs", (n,), "f4"), ("infos/qpos", (n, 6), "f8"), ("infos/qvel", (n, 6), "f8")]:
        put(f, name, shape, t, compression="gzip")
    f["metadata/algorithm"] = np.bytes_("SAC")
    f["metadata/iteration"] = np.int32(-125)
    put(f, "metadata/policy/fc0/weight", (8, 11), "f4")
    put(f, "metadata/policy/fc0/bias", (8,), "f4")
    f["metadata/policy/nonlinearity"] = np.bytes_("relu")


def minari(f):
    for e in range(12):
        g = f.create_group("episode_%d" % e, track_order=True)
        g.attrs["id"] = e
        g.attrs["total_steps"] = 20 + e
        put(g, "observations", (21 + e, 4), "f8")
        put(g, "actions", (20 + e, 2), "f4")
        put(g, "rewards", (20 + e,), "f8")
        put(g, "terminations", (20 + e,), "?")
        put(g, "truncations", (20 + e,), "?")
        put(g, "infos/qpos", (21 + e, 3), "f8", compression="gzip")


def root(f):  # attributes of the root group, of which single numbers are read; soft links of every kind
    f.attrs["total_episodes"] = 12
    f.attrs["half"] = np.array([0.5], ">f4")
    f.attrs["algorithm"] = "SAC"
    f.attrs["fixed"] = np.bytes_("SAC")
    f.attrs["several"] = np.arange(3)
    put(f, "group/a", (3,), "f4")
    for path, to in [("a", "/group/a"), ("group/b", "a"), ("group/./c", "/alias/.//b"), ("alias", "group"),
                     ("alias_of_alias", "/alias"), ("self", "/"), ("gone", "/nowhere"), ("circle", "circle")]:
        f[path] = h5py.SoftLink(to)


def peers(f):  # what other programs' files have beside the plain things
    put(f, "lzf/float", (300, 3), "f4", compression="lzf", chunks=(100, 3))
    put(f, "lzf/shuffled", (300, 3), "f8", compression="lzf", shuffle=True, fletcher32=True, chunks=(128, 2))
    f.create_dataset("lzf/zeros", data=np.zeros(5000, "i4"), compression="lzf")
    put(f, "lzf/kept", (3,), "u1", compression="lzf")  # grows, so the filter is skipped
    half = np.array([0, 1, -2, 0.333, 65504, 6.1e-5, 5.96e-8, 1.2e-6, np.inf, -np.inf, np.nan, -0.0], "f2")
    f["half/little"] = half
    f["half/big"] = half.astype(">f2")
    f["line\nbreak"] = np.zeros(2, "f4")
    g = f["lzf"]
    for i in range(40):
        g = g.create_group("deeper%d" % i)
    put(g, "deep", (2,), "f4")
    for i in range(15):
        g = g.create_group("below%d" % i * 50)  # to paths of 5,000 bytes
    put(g, "out_of_reach", (2,), "f4")
    f["a/b/c/first"] = f["half"]  # hard links: to a group that a shorter path leads to, to the parent, to itself
    f["a/parent"] = f["/"]
    f["a/b/self"] = f["a/b"]
    f["also_a"] = f["a"]
    f.create_virtual_dataset("refused/virtual", h5py.VirtualLayout((4,), "f4"))
    put(f, "refused/scale_offset", (64,), "i4", scaleoffset=0, chunks=(64,))
    low_level(f["refused"], "n_bit", (8,), "i4", chunks=(8,), change=lambda p: p.set_filter(h5py.h5z.FILTER_NBIT, 0))
    f["type"] = np.dtype("f4")
    f.create_dataset("refused/committed", data=values((3,), "f4"), dtype=f["type"])


def tables():  # PyTables 3.11.1: bools as bit fields of a byte, and Blosc
    import tables as pytables
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "f")
        with pytables.open_file(path, "w") as f:
            f.create_array("/", "flags", values((40,), "?"))
            f.create_carray("/", "zipped", obj=values((40,), "?"), filters=pytables.Filters(5, "zlib"))
            f.create_carray("/", "blosc", obj=values((400,), "f4"), filters=pytables.Filters(5, "blosc"))
        pack("tables", open(path, "rb").read())


def shared():  # h5repack -s 1 (HDF5 1.10.8): a header's messages lie in a heap that objects share
    with tempfile.TemporaryDirectory() as folder:
        old, new = os.path.join(folder, "f"), os.path.join(folder, "g")
        with h5py.File(old, "w") as f:
            put(f, "actions", (5, 2), "f4")
            put(f, "observations", (5, 2), "f4")
        subprocess.run(["h5repack", "-s", "1", old, new], check=True)
        pack("shared", open(new, "rb").read())


def minaris():  # Minari 0.5.4, Gymnasium-Robotics 1.4.2, MuJoCo 3.4.0: two short episodes each, of random actions
    import gymnasium, gymnasium_robotics, minari as library_of_minari
    gymnasium.register_envs(gymnasium_robotics)

    class Whole(gymnasium.RewardWrapper):
        def reward(self, reward):
            return int(reward)  # stored as int64
    for name, id, steps in [("pointmaze", "PointMaze_Medium-v3", 12), ("antmaze", "AntMaze_UMaze-v4", 3), ("hopper", "Hopper-v5", 15)]:
        env = gymnasium.make(id, max_episode_steps=steps)
        env = library_of_minari.DataCollector(env if name == "hopper" else Whole(env), record_infos=False)
        rng = np.random.default_rng(0)
        for episode in range(2):
            env.reset(seed=episode)
            for _ in range(steps):
                env.step(rng.uniform(-1, 1, env.action_space.shape).astype("f4"))
        made = env.create_dataset(dataset_id=name + "/x-v0", algorithm_name="a", author="b", author_email="c", code_permalink="d")
        pack(name, (pathlib.Path(made.storage.data_path) / "main_data.hdf5").read_bytes())


def skewed():  # no HDF5: 4180 bytes, byte k Fibonacci(k + 1) times, so that codes have up to 15 bits
    a, b, text = 1, 1, b""
    for k in range(17):
        text += bytes([k]) * a
        a, b = b, a + b
    text = bytes(text[i * 2531 % len(text)] for i in range(len(text)))
    c = zlib.compressobj(9, strategy=zlib.Z_HUFFMAN_ONLY)
    (here / "skewed.z").write_bytes(struct.pack("<Q", len(text)) + c.compress(text) + c.flush())


def everything(f):
    for part in [types, texts, strange, filters, chunks, compact]:
        part(f)


def short(f):
    put(f, "a", (3,), "f4")


if suffix == "":
    make("old", everything)
    make("latest", everything, libver="latest")
    make("old_large", large_indexes)
    make("latest_large", large_indexes, libver="latest")
    make("small_old", small)
    make("small_latest", small, libver="latest")
    make("many_old", many)
    make("many_latest", many, libver="latest")
    make("long_names", long_names, libver="latest")
    make("root_old", root)
    make("root_latest", root, libver="latest")
    make("minari", minari, track_order=True)
    make("edges", edges, libver="latest")
    make("superblock1", short, istore_k=16)
    make("superblock2", short, libver=("v108", "v108"))
    make("userblock", short, userblock_size=1024)
    make("peers_old", peers)
    make("peers_latest", peers, libver="latest")
    tables()
    shared()
    minaris()
    skewed()
else:
    make("latest", everything, libver="latest")
    make("d4rl", d4rl)

"""Local folders and object stores behind the same few operations.

In: paths and addresses. Out: their content, listed, read, written whole or not at all.
Touches files and stores, and knows nothing of what they hold.

`address` is how places are named; `files` reads one file; `fetching` lists, and reads many; `writing` puts files there
whole or not at all; `identity` tells whether content is still the same; `noted` knows what a step has read;
`object_store` opens the stores, and is the patience with those that fail; `objects` is what they say of an object, and
whether what came is that.
"""

from pipeline.storage.fetching import (
    content_of,
    files_below,
    folders_in,
    glob_remote,
    local_copy,
    reach,
    read_many,
    require_match,
    sizes,
)
from pipeline.storage.identity import (
    FileDigest,
    FileState,
    digest_of_files,
    file_digests,
    signature,
    version,
)
from pipeline.storage.writing import (
    UNFINISHED,
    SweptError,
    absolute,
    as_output_error,
    commit,
    discard,
    remove,
    remove_folder,
    remove_folders,
    replace_files,
    stage,
    unfinished_in,
    whole_file,
    write_bytes,
)

__all__ = [
    "UNFINISHED",
    "FileDigest",
    "FileState",
    "SweptError",
    "absolute",
    "as_output_error",
    "commit",
    "content_of",
    "digest_of_files",
    "discard",
    "file_digests",
    "files_below",
    "folders_in",
    "glob_remote",
    "local_copy",
    "reach",
    "read_many",
    "remove",
    "remove_folder",
    "remove_folders",
    "require_match",
    "replace_files",
    "signature",
    "sizes",
    "stage",
    "unfinished_in",
    "version",
    "whole_file",
    "write_bytes",
]

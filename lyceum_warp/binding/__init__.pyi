from lyceum_warp.binding.bound_task import BoundTask as BoundTask
from lyceum_warp.binding.functions import TaskSource as TaskSource
from lyceum_warp.binding.layouts import action_sizes as action_sizes, observation_layouts as observation_layouts
from lyceum_warp.binding.models import (
    compile_model as compile_model,
    task_spec as task_spec,
)
from lyceum_warp.binding.opened_files import (
    data_files as data_files,
    stamps as stamps,
)
from lyceum_warp.binding.parameters import defaults as defaults
from lyceum_warp.binding.registry import (
    class_in_file as class_in_file,
    class_sources as class_sources,
    errors_of as errors_of,
    file_name as file_name,
    find_task as find_task,
    made as made,
    object_in_file as object_in_file,
    package_task_names as package_task_names,
    register as register,
    snake_case as snake_case,
    source_files as source_files,
    spelled_task as spelled_task,
    task_name as task_name,
    task_names as task_names,
)
from lyceum_warp.binding.sources import (
    FunctionSource as FunctionSource,
    is_row as is_row,
    is_struct as is_struct,
    name_of as name_of,
    overloads as overloads,
)
from lyceum_warp.binding.writes import written_fields as written_fields

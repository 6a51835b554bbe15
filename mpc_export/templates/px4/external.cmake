# make px4_sitl EXTERNAL_MODULES_LOCATION=path/to/this/folder
set(config_module_list_external
	modules/@NAME@
	PARENT_SCOPE
	)

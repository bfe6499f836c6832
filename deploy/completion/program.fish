# fish completion of PROGRAM: click knows the words, and what each is for.
function _FUNCTION
    set -l lines (env _VARIABLE_COMPLETE=fish_complete COMP_WORDS=(commandline -cp) \
        COMP_CWORD=(commandline -t) PROGRAM 2>/dev/null)
    for line in $lines
        set -l parts (string split -m 1 , -- $line)
        switch $parts[1]
            case dir
                __fish_complete_directories $parts[2]
            case file
                __fish_complete_path $parts[2]
            case plain
                echo $parts[2]
        end
    end
end
complete --no-files --command PROGRAM --arguments '(_FUNCTION)'
